"""Kinds of number that the algebra and the algorithms can be run on besides tensors; they import nothing."""
