"""Tools of all packages: errors, settings, the stage interface, files, memory, threads.

What every stage is made of: `errors`, `settings` and `stage`, whose run may be stopped
(`interrupt`). Files: `atomic` writes them, `bad_files` reports those that cannot be read, `disk`
and `usd_path` are about folders and names. Memory and threads: `memory`, `row_slices`, `scratch`,
`threads`, `torch_vml`. Processes: `parent`. Output: `text`, `plots`. What made a result:
`libraries`, `distribution`.
"""
