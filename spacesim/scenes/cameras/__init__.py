"""Where frames are taken from, and the lens and the sensor that take them."""
