"""The fast surrogate: the same survey with measurements drawn from calibrated error models in place of images."""
