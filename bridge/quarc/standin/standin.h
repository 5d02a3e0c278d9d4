/* What tests need from the stand-in and QUARC does not have. */
#ifndef STANDIN_H
#define STANDIN_H

#include "quanser_stream.h"

/* Returns the port on which a server listens, for servers at port 0. */
int standin_port(t_stream server_stream);

/* Limits the operating system's send buffer of later connections, bytes; 0 leaves the default. */
void standin_limit_socket(int send_bytes);

#endif
