"""Training: one loop for every model, and what each model is trained on."""
