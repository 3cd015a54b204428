"""One-shot-prior: the shipped prior, frozen, and few tensors that bend it to a person."""
