"""Time against pose error of everything the plan can choose, and of pycolmap's defaults."""
