"""Operations on finished splats, one after the other: select, move, join, and make fewer.

`syntax` parses operations, `operations` applies them to a `scene`. They use `regions`,
`expression` and `decimate`; `levels` decimates for streamed files.
"""
