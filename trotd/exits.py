"""The exit codes of every command."""

FAILED = 1
"""It was refused, it fell, a bound was missed: what was asked could not be done."""
BAD_INPUT = 2
"""What was given cannot be: a file, a key, a number, options."""
INTERRUPTED = 130
"""By Ctrl-C, as a shell has it."""
