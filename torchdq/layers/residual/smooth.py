"""Steps and limits whose first and second derivatives exist everywhere."""

from torch import Tensor

ROOM = 0.5  # distance beyond a limit, in units of it, over which the slope falls from one to zero
BEYOND = 1 + ROOM / 2  # largest size of what is limited, in units of the limit


def smooth_step(t: Tensor) -> Tensor:
    """Step from 0 to 1 along t^3 (10 - 15 t + 6 t^2): zero for t <= 0, one for t >= 1, exactly."""
    t = t.clamp(0.0, 1.0)
    return t * t * t * (10 + t * (6 * t - 15))


def step_slope(t: Tensor) -> Tensor:
    """Derivative of `smooth_step`."""
    t = t.clamp(0.0, 1.0)
    return 30 * (t * (1 - t)).square()


def limited(x: Tensor, limit: Tensor) -> Tensor:
    """Numbers x as they are up to `limit` in size, bent beyond it, and never more than `BEYOND` times it in size."""
    end = (1 + ROOM) * limit
    return x.clamp(-end, end) - x.sign() * limit * _bend(_past(x.abs(), limit))


def limit_slope(x: Tensor, limit: Tensor) -> Tensor:
    """Derivative of `limited`."""
    return 1 - smooth_step(_past(x.abs(), limit))


def _past(size: Tensor, limit: Tensor) -> Tensor:
    """How far a size is past its limit, in units of the room there."""
    return size / (ROOM * limit) - 1 / ROOM


def _bend(t: Tensor) -> Tensor:
    """Integral of `smooth_step` from 0 to t, in units of the limit, for t up to one."""
    t = t.clamp(0.0, 1.0)
    squared = t * t
    return squared * squared * (2.5 * ROOM + ROOM * t * (t - 3))
