"""Time and pose error of all options of the plan, and of pycolmap's defaults."""
