"""Statistics of splat files, and the proof that a file holds the splats it was made from.

`prover` proves a file by the row of its format in `checks`: an independent reader
(`independent_readers`, `independent_packed`) gives its `content`, `matching` finds the same splats
in both, and `compare` measures the differences; `losses` tells those that show, and
`usd_validation` asks USD's own validators. `statistics` is what `splat info` prints.
"""
