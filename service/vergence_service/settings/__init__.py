"""All settings of the server. ``sections`` has the keys, ``loading`` reads them."""

from vergence_service.settings.loading import Settings, SettingsError, load_settings

__all__ = ["Settings", "SettingsError", "load_settings"]
