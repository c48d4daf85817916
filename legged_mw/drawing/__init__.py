"""The looks of a robot and its ground: sky, light, camera, terrain colours. Not part of the simulation."""
