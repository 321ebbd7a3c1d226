"""The navigation task of one arena: stages, levels, observation, reward, environment."""
