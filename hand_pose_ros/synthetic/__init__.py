"""Fresh labelled depth images of hands: the hand, its poses, the renderer, the sensors."""
