"""Robots made from robots: locked, cut, combined and coupled joints, changed bodies."""
