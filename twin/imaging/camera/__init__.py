"""From radiance to pixel values: lens, port, shutter, sensor, white balance."""
