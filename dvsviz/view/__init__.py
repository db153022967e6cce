"""What a person sees of a session: images, the 3-D scene, playback."""
