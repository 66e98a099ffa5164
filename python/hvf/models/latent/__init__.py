"""The latent model: a general compact world model that plans without drawing a frame."""
