"""Programs as source code that needs neither Python nor torch.

c99      text of a function in C
parts    text of a long function in several short ones
batch    text of the function for batches, in loops that become vector instructions
rollout  text of the function for many steps, if the program is one
golden   text of the test, with golden vectors
files    what is written to a folder: source, headers, test, CMake file
meaning  words and units for the arguments and results of programs
casadi   the same function behind CasADi's interface for external functions
"""
