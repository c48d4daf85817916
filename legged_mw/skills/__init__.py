"""Tasks other than walking: getting up, handstands and motion tracking. The core imports none of them."""
