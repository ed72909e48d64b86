"""Operators of the paper as printed, their counted costs, and textbook formulations to compare with.

Not part of the public interface; written for any kind of number.
"""
