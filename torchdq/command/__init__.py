"""Command line `torchdq`: one file for each command, which only reads its options and words what the package computes.

main      parsing, exit codes, warnings and errors
command   what all commands share
outcome    result of a command, as text and as JSON
robots    robots by file or name
report bench identify scene accuracy export view cost doctor
"""
