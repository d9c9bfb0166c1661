"""The trained detector: existence of an object, features of a candidate, and the model over them."""
