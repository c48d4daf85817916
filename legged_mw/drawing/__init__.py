"""How a robot and its ground look: sky, light, camera, relief. A tool: nothing here is stepped."""
