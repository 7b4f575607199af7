"""What the photographs of a scene did not see."""
