"""The sky's level and structure: background, masks, flats, stripes."""
