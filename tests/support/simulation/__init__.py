"""Runs the engine in one thread on a simulated machine: its clock, network, process table, disk and pipes.

`world` is time and the tasks that share it, `machine` the modules of the operating system as the engine sees them,
`run` one run on it, `plan` what happens in it by a seed, `check` what must hold afterwards.
"""
