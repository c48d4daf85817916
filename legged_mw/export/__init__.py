"""A trained policy to take away: network, contract, scene, and their comparison with what was trained. Nothing in rl imports it."""
