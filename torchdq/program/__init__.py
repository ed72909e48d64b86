"""Programs: the straight-line arithmetic that is left of an algorithm. Nothing here knows what a robot is.

program     what a program is: recorded, counted, printed, replayed, its dead code removed
autodiff    its derivatives, which are programs again
schedule    the order in which it is computed, whatever language it is printed in
autograd    programs in torch's graphs: gradients, transforms, traced graphs
transforms  questions about torch's transforms, by its private symbols
"""
