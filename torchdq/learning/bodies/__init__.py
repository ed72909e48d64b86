"""Bodies that measurements allow: robots drawn around an identified one, and payloads."""
