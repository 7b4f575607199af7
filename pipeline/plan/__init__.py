"""The scan of a scene folder and the plan: stages, settled options, budgets."""
