"""Runs, and blocks of a scene, here or on a Ray cluster.

`tasks` has the executor that all use; `cluster` is the one on Ray, `remote` copies files for it.
What is distributed: many captures (`batch`), and blocks of one scene (`blocks`, with `partition`,
`block_folders` and `merge`).
"""
