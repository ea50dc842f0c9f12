"""Small fully connected networks over many items at once."""
