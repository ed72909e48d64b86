"""Backends: how a program runs on tensors."""
