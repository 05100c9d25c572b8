"""Runs, blocks of a scene and chunks of structure from motion, here or on a Ray cluster.

`tasks` has the executor that all use; `cluster` is the one on Ray, `remote` copies files for it.
What is distributed: many captures (`batch`), blocks of one scene (`blocks`, with `partition`,
`block_folders`, `merge`), features and matches (`sfm_chunks`).
"""
