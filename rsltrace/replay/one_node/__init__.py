"""One node of a recording alone: fed with what it got, and what it then does compared."""
