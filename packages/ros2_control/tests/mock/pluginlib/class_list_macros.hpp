// Mock of pluginlib: the library exports a function that makes its one class.
#pragma once

#define PLUGINLIB_EXPORT_CLASS(Class, Base) \
  extern "C" Base* mock_create();           \
  extern "C" Base* mock_create() { return new Class; }
