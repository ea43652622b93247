"""Archives of Zemax (.zar)."""
