"""Stage 1: photographs, videos and panoramas -> `Capture`: upright pictures, EXIF, masks, depth."""
