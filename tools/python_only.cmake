# SPDX-License-Identifier: Apache-2.0
# Messages for Python alone: half of what the default generators compile is for C++ nodes, of which
# `make` builds none. rclpy and rmw_fastrtps_cpp need the C ones (its introspection too: it describes
# each type to DDS). For CMAKE_PROJECT_TOP_LEVEL_INCLUDES; a workspace of colcon gets all generators.
cmake_minimum_required(VERSION 3.24)

macro(robocal_python_only method package)
  find_package(${package} ${ARGN} BYPASS_PROVIDER)
  list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp:")
endmacro()

cmake_language(SET_DEPENDENCY_PROVIDER robocal_python_only SUPPORTED_METHODS FIND_PACKAGE)
