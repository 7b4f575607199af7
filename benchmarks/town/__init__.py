"""The synthetic town: streets of houses that grow with the number of photographs."""
