"""The scan of a scene folder, and the plan: which stages run, with which options."""
