"""Checks, files, optional packages, caches and progress: general tools that know no robot."""
