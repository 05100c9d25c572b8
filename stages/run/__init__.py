"""Run folders: manifests, digests, what runs again and why, and the run itself.

`stages` lists the stages, `pipeline` runs them. `planning` decides which of them run, by a
`request` compared with a `manifest` and its `digests`. `attempt` runs one stage in its `workspace`;
`failures` explains what the system refuses. A run folder: `runfolder`, `runfile`, `lock`; `results`
reads what is in it. `listener` hears of the events of a run, `time_limit` divides `--seconds`.
"""
