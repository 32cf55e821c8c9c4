"""How right a result is: views left out, contact readings, other results, truth."""
