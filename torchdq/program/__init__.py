"""Programs: the straight-line arithmetic that is left of an algorithm for one robot.

program   what a program is: counted, printed, its dead code removed
derive    its derivatives, which are programs again
c         its source in C, one sample per vector lane
build     the compiled source, kept in a private cache
run       running it on tensors, compiled or operation by operation, with gradients and transforms
backends  which of the two
model     a robot as numbers to record
recipes   the public functions as computations on numbers
"""
