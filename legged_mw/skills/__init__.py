"""Robots that get up, stand on two legs or follow a motion: siblings of walking. The core imports none of them."""
