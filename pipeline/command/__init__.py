"""The command ``splatmake``."""
