"""Defaults that pruning and quantisation share."""

SOG_LOSS_DB = 0.3  # PSNR of training views that the bit depths of a .sog file may cost
DECIDING_VIEWS = 12  # training views, at most, on which bit depths are measured
