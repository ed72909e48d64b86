"""Number types other than floats and tensors, on which the algebra and the algorithms run: recorded and counted.

ops        the table of operations
functions  square root, sine and other functions of numbers of any type
record     a number that records the operations on it
count      a number that counts the operations on it
"""
