"""The rasteriser: several backends (`backends`), one definition (`reference`)."""
