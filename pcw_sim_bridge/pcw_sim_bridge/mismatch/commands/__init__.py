"""The subcommands of `mismatch`, one module each.

A module has `add_parser(commands)`, which adds its parser and sets `run`, and `run(options)`, which returns the exit code.
What is heavy is imported in `run`, so that --help and bad input answer at once. A parser may set `interrupted`, what to say
of the output after Ctrl-C.
"""
