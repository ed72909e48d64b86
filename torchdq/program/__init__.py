"""Programs: straight-line arithmetic, recorded from an algorithm. Nothing here depends on robots.

program     a program: recording, dead code elimination, operation count, text, replay on other numbers
autodiff    derivatives of programs, which are programs again
uniform     values that all samples share, and the split of a program into these and the rest
order       orders in which operations can be evaluated
schedule    order of evaluation, for code in any language
autograd    programs in torch's graphs: gradients, transforms, traced graphs
loop        a program that is applied step after step, and its adjoint, as one call
loop_autograd  loops in torch's graphs: gradients of any order
transforms  state of torch's transforms, read from its private symbols
"""
