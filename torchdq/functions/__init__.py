"""Public functions as computations on numbers, and their compilation ahead of time.

catalogue  what each function computes, its arguments and the shapes of its results
compile    compilation before the first call, and inspection of the program
"""
