"""Statistics of splat files, and the proof that a file holds the splats it was made from.

`prover` proves a file by the row of its format in `checks`: an independent reader
(`independent_readers`, `independent_packed`) gives its `content`, `matching` finds the same splats
in both, `compare` measures the differences, and `diagnosis` names the likely error of the writer.
`statistics` and `byte_breakdown` are what `splat info` prints.
"""
