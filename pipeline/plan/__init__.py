"""What a folder of photographs holds, and which stages and budgets it needs."""
