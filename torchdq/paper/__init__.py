"""Other formulations of the same kinematics and dynamics, to be compared with: homogeneous matrices, D-H parameters,
and the paper's operators as they are printed. Not part of the public face; written for any kind of number.
"""
