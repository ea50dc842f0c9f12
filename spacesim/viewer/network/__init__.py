"""Who may connect, and what of that is let through."""
