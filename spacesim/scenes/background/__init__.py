"""What pictures show behind the objects: the Earth, stars."""
