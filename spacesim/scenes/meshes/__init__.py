"""Any mesh file as parts with materials."""
