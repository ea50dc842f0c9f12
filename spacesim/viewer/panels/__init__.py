"""What stands beside the picture: sliders, fields and buttons, and handles in the scene."""
