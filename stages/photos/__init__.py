"""Reading photographs: decoding, EXIF, colour, and what to shoot again."""
