"""What is to be measured on a machine with a GPU that is there for minutes: `python -m
tests.device.gather` packs what such a machine lacks, `python -m tests.device.run` runs the parts.

`run` starts each part of `parts` in a process of its own, under a time limit of its own. A part is
a module here that writes each of its results at once through `results`: `versions`, `warm`,
`hostile`, `sanitised`, `steps`, `host`, `training`, `rows`, `counters`, `theirs`. `made` has the
scenes.
"""
