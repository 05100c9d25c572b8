"""Stage 6: at which precision splats are stored, and fine-tuning to the rounding of formats.

`stage` decides, and calls `format_finetuning`, which fine-tunes by `rounding`. `settings` are the
options. The bits of a `.sog` are chosen in `stages.formats.sog_bits`.
"""
