"""Runs of many captures, here or on a Ray cluster.

`batch` has their table, `tasks` the executor, `cluster` the one on Ray; `remote` copies files for
it.
"""
