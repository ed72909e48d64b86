"""Rotations of descriptions as matrices, written out by hand; tensors of inertia and their six numbers."""

import math

import numpy as np


def rotation(rpy):
    """Matrix of roll, pitch and yaw: about the fixed x, then y, then z axis."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x


def about(axis, angle):
    """Matrix of a turn about a unit axis, by Rodrigues."""
    x, y, z = axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K


def angles(R):
    """Roll, pitch and yaw of a matrix, away from a pitch of a quarter turn."""
    return math.atan2(R[2, 1], R[2, 2]), -math.asin(R[2, 0]), math.atan2(R[1, 0], R[0, 0])


def tensor(six):
    """Matrix of an inertia xx xy yy xz yz zz."""
    xx, xy, yy, xz, yz, zz = six
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def flat(I):
    """Numbers xx xy yy xz yz zz of a matrix."""
    return I[0, 0], I[0, 1], I[1, 1], I[0, 2], I[1, 2], I[2, 2]
