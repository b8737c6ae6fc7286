"""A chat server in the dialect of OpenAI, with our own models."""
