"""The web server: page, REST, websocket, proxy to the 3-D scene."""
