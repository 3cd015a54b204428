"""Result tables, figures and the report page."""
