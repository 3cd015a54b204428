"""One person: settings, skin, hands, arms, and what is worn."""
