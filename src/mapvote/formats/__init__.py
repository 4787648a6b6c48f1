"""Maps and drives in other people's file formats."""
