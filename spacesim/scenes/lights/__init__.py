"""What shines: the Sun, and the Earth that it lights."""
