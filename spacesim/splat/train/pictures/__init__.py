"""What is learned of each training picture."""
