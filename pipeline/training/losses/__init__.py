"""Terms of the loss, as gradients on the rendered images."""
