"""Rigid-body algorithms on any kind of number, one per file; they import the algebra and nothing else.

An algorithm takes a `Mechanism` (numbers, not tensors), the adjoint columns of its joints, and component tuples.
Whatever is absent (no gravity, no velocity, no external wrench) is `None`, which is decided here in Python and costs
nothing.
"""
