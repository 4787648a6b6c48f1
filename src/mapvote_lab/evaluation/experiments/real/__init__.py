"""Anyone's recorded drive as a bench: a street that did not change, and changes cast into its scans."""
