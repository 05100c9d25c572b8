"""Stage 2: `Capture` -> `Reconstruction`: structure from motion by COLMAP, or known cameras.

In reading order, without known cameras:
- `settings`, `stage`: the options; the stage from its input to its files.
- `checks.fallbacks` lists configurations and tries them; `checks.attempt_runner` runs one of them.
- `worker.process` runs one step (`worker.job`) in a process of its own.
- In that process: `worker.features` (SIFT), then pairs of photographs by `worker.retrieval` over a
  `worker.vocabulary` and by `worker.pairs`, `worker.matching`, and `worker.mapping`.
- `learned`: features for the photographs that SIFT leaves out.
- `worker.sparse_model` holds the result; `checks.statistics` measures it, `checks.gates` refuse it,
  and `checks.acceptance` decides which attempt is used.

With known cameras: `known`.

Both end in `finish`: `place` finds up, scale and north, and `undistorted_images` writes pictures.
Then `light` measures exposure and white balance, and `reconstruction_files` stores the result.
"""
