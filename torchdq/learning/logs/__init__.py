"""Logs of robot arms: files and arrays read and checked, and the motions that they hold."""
