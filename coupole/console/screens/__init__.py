"""The console's screens, in NiceGUI: each module builds one; `all_screens` lists them."""
