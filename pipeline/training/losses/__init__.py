"""Loss terms besides the colour loss: gradients with respect to rendered alpha and depth."""
