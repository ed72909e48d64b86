"""Programs as source code that needs neither Python nor torch.

c99      text of a function in C
files    what is written to a folder: source, header, test with golden vectors, CMake file
meaning  words and units for the arguments and results of programs
casadi   the same function behind CasADi's interface for external functions
"""
