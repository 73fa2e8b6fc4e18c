"""What `twin plan` does: a survey's plan as numbers and a picture, without a simulation."""
