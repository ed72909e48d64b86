"""Checks of robots: consistency, units, and reports of both."""
