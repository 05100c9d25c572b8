"""Stage 4: `Splats` -> `TrainedSplats`: the loop, its steps, loss, optimiser and densification.

`stage` and `build` make a trainer from `settings`. `loop` makes the steps of a `trainer`,
`schedule` says what happens at which step, `hooks` lists what happens between steps: `average`,
`free_space`, `density`, `sparsification`, `colour_refit`, evaluation (`history`), `time_limit`,
`checkpoint`. A step trains on one of the `views`, in `steps`, by `loss` and `optimiser`, perhaps
with `dropout` or `camera_refinement`. Around it: `conversion`, `album`, `cap`, `clock`. At the end:
`quality`, `charts`. `finetune` trains finished splats further for later stages.
"""
