"""The promises that every public function keeps, and the functions."""
