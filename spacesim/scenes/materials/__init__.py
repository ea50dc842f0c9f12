"""What surfaces are made of: the table, spectra, pictures."""
