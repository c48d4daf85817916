"""Numbers, configuration and tasks. Every other package may import it; it imports none of them."""
