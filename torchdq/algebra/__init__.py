"""Algebra of sections 2 to 4 of the paper, and inertia, on numbers of any type.

Every function takes and returns tuples of components and uses only `+ - * /`, so the components may be floats,
tensors, multi-precision, counted or recorded numbers. Values of functions that are not rational (cosine, the angle of
a logarithm) are arguments. Nothing here imports anything outside this folder.

    quaternion       4-tuples (w, x, y, z); pure quaternions are 3-tuples (x, y, z)
    dual_quaternion  pairs (primary, dual) of quaternions
    screw            pairs (primary, dual) of pure quaternions: twists, wrenches, lines; their adjoint
    elementary       screws about one axis of a frame, and their adjoint
    inertia          mass, first moments and second moments or rotational inertia of a body
    structural       operations that skip absent terms (None), the structural zeros
    matrix           vectors and matrices of the above, and of operators on them
"""
