"""How each model is trained: one recipe a model."""
