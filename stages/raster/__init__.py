"""The rasteriser: one definition (`reference`) and several backends (`backends`)."""
