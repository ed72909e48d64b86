"""Choice of precision, integrator and step: the cheapest that keep an error."""

from torchdq.recommend.recommend import recommend_settings

__all__ = ["recommend_settings"]
