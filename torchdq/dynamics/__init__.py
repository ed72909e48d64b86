"""Rigid-body algorithms on numbers of any type, one per file; they import only `algebra` and `numbers`.

    joints, tree      joint types; links, joints and coordinates of a robot
    posed             interface of a robot at one configuration
    aligned           the form that runs: frames whose z axes are the joint axes
    general           the reference: the paper's algorithms, in any link frames
    crba, ltdl        mass matrix by composite rigid bodies, and its sparse factors
    energy, regressor, acceleration, error_growth, coupling    parts that both forms share

Absent quantities (no gravity, no velocity, no external wrench) are `None`: Python decides, and nothing is recorded.
"""
