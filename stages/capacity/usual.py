"""Defaults that two stages share."""

SOG_LOSS_DB = 0.3  # PSNR that fewer bits may cost photographs of training
DECIDING = 12  # photographs of training, at most, that such choices are measured on
