"""The algebra of the paper's sections 2 to 4, on any kind of number.

Every function takes and returns tuples of components and uses only `+ - * /`, so the components may be floats,
tensors, multi-precision numbers, counters or recorders. Functions that are not rational (cosine, logarithm's angle)
are handed in by the caller. Nothing here imports anything outside this folder.

    quaternion       4-tuples (w, x, y, z); pure quaternions are 3-tuples (x, y, z)
    dual_quaternion  pairs (primary, dual) of quaternions
    screw            pairs (primary, dual) of pure quaternions: twists, wrenches, lines
    matrix           vectors and matrices of the above, and of operators on them
"""
