"""The subcommands of `cablejax`, one per file: a dataclass of options whose `run` does the work.

Nothing here imports JAX or MuJoCo before `run`, so that `cablejax --help` answers at once.
"""
