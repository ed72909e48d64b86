"""Command line `torchdq`: one file for each command, which only reads its options and words what the package computes.

`main` parses and has the exit codes, `command` the options that all share, `outcome` the result as text and as JSON.
"""
