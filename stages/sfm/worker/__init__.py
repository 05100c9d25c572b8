"""Structure from motion in a process of its own, because COLMAP may abort the process it runs in.

In reading order: `job` (the message of each step), `process` (runs the process and watches it),
`progress`, `__main__` (the process itself). In the process:
`new_database`, `features`, `vocabulary`, `retrieval`, `pairs`, `descriptor_matching`, `matching`,
`initial_pair`, `mapping`, `pair_checks`. On both sides: `database`, `sparse_model`.
"""
