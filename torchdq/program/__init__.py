"""Programs: the straight-line arithmetic that is left of an algorithm for one robot.

program   what a program is: counted, printed, its dead code removed
derive    its derivatives, which are programs again
c         its source in C, one sample per vector lane
build     the compiled source, kept in a private cache
"""
