"""Message classes to canonical CDR and back, and what their interfaces are made of."""
