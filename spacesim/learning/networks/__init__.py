"""Small fully connected networks over many items at once, and arrays joined for few kernels."""
