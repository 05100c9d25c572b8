"""Decides what a model may lose: which splats and SH coefficients go, and at which precision the
rest is stored. The constants are defaults that two stages share."""

SOG_LOSS_DB = 0.3  # PSNR of training views that the bit depths of a .sog file may cost
DECIDING_VIEWS = 12  # training views, at most, on which bit depths are measured
