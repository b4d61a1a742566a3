"""Two balls on a table in one camera: closed-form rolling, sliding and impact."""
